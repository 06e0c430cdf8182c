"""What was changed in a drive, noted on disk before, and put back byte for byte."""
