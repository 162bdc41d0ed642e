"""Where the sim-to-real gap lies, which unmodelled effect causes it, how far it shrinks."""
