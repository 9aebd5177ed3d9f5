"""Warp twins of the hot functions: same names and signatures as the torch reference."""
