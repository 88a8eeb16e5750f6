"""Reports of the arm study and of a patient's organ as HTML pages."""
