"""Evaluation: of robot arms on a patient's anatomy."""
