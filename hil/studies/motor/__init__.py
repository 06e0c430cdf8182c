"""Motor files from data sheets: ``hil motor new``."""
