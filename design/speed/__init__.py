"""Speed controllers: design, tuning, and robustness against spread of the motor."""
