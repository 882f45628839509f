"""A policy as one ONNX file that says itself how to be used, and a runtime for it that needs no torch."""
