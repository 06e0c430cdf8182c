"""Looking at a bus and its drives without moving them: who is there, and what faults they tell."""
