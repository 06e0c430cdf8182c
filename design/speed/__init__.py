"""Speed controllers: designed, tuned, held against spread of the motor."""
