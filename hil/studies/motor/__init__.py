"""Motor files out of data sheets: ``hil motor new``."""
