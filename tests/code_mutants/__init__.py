"""``make mutate``: one defect at a time is put into the product, and the tests have to see it.

Not to be confused with :mod:`tests.mutants`, which mutates the files that the product reads.
"""
