"""Effects that a plain plant leaves out, one file per family, and the catalogue that collects them."""
