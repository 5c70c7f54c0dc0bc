"""READ and WRITE: the only place that opens a survey file.

`READERS`, `WRITERS` and `REWRITERS` are the tables of formats; a new format is one module and its
lines here. Each entry names a function by "module:function", imported at first use.
"""

from __future__ import annotations
