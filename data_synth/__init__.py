"""Synthetic repeat surveys of the seafloor, with the truth beside them.

Shares no code with what it tests: it may use `meshreg`'s records and writers, nothing else.

The usual ways in: `recipe.load` reads a scenario, `make.make_pair` makes both surveys in memory,
`make.write_pair` as files, `make.make_rasters` straight as rasters for many trials.
"""
