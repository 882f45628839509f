"""Configuration: the one schema and the one loader."""
