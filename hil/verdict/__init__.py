"""What a run came to: verdict, exit status, summary, and both in lines for a reader."""
