"""Techniques that others ship, written from their published formulae, to be measured beside this library."""
