"""Parameters of drives of many data sheets, saved, reset, and loaded with a kill in every phase."""
