"""Hidden drives, drawn, recorded and fitted: does k = 2 hold?"""
