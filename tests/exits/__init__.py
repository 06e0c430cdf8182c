"""Whatever ends a run, or stands still in it: in each phase, one program after the other, and the disk."""
