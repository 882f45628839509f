"""Measuring policies: the tracking protocol, tables and figures."""
