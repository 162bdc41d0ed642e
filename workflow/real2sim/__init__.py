"""Real2Sim calibration of a person coupled to a robot by a pelvic strap."""

__version__ = "0.1.0"
