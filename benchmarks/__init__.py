"""Measurements of speed and memory; ``eagle bench`` runs them. Nothing here is a test: figures depend on the machine."""
