"""[Ling2012] and [Azaiz2007] as printed."""
