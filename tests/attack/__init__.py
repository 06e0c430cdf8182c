"""An attack on certified peaks, by a simulation that shares no code with the certificate."""
