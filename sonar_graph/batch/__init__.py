"""Many runs from one file: logs or simulations, seeds, estimators and variants, each run kept once and never lost.

`suite` reads what is asked for, `plan` makes a list of runs of it, `one_run` does one of them in a process of its own
(`runner`), which `supervision` watches from a Dask worker (`execution`); `store` keeps what came out, and `results`
makes one table of it. Decisions: docs/design/0011-batch.md.
"""
