"""Each data sheet's three commands on the hub, held against each other and against the frames on the bus."""
