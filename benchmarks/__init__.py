"""Measurements of speed and memory, run by ``eagle bench``; figures depend on the machine, so none is a test."""
