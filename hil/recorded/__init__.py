"""What is done with a recorded run: judged anew, compared, drawn, shown."""
