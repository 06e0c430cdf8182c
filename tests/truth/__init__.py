"""Truth taken outside the bench, against which every row of a run is judged.

The taps sit on the segment, between the loop and its port, and between the bus and each simulated drive.
They follow frame objects from hand to hand, so which reading answers which SYNC is known and not inferred;
nothing of the bench's own attribution, clock map or echoes is used.
"""
