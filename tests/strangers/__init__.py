"""How many single frames of strangers a bench names, and how often it names one that there was not."""
