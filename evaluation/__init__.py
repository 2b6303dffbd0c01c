"""Evaluation: measures, figures, tables and the report. Arrays in, files out; knows no network."""
