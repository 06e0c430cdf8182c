"""The result of a run: verdict, exit status, summary, and both in lines for a reader."""
