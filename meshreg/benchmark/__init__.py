"""The paper's experiment on pairs with known truth: how right, how sure, how fast.

`run_benchmark` makes the pairs (`data_synth`), registers them in worker processes, one file a
pair so that a stopped run can be resumed, and draws tables, figures and a page from those files.
"""

from __future__ import annotations

from meshreg.benchmark.measure import register_rasters
from meshreg.benchmark.plan import Options
from meshreg.benchmark.run import run_benchmark

__all__ = ["Options", "register_rasters", "run_benchmark"]
