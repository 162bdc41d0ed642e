"""Recordings of the described systems, simulated by equations of motion that share nothing with the replay.

Each module has ``EFFECTS`` (the effects that it can inject, with a typical size and its unit) and
``simulate(effect, size, seed, out)``, which writes quiet.parquet, train.parquet, held_out.parquet and
sealed/truth.json.
"""
