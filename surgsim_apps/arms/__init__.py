"""Evaluation of two arms on a patient: reach, clearance, dexterity, forces."""
