"""What is told and written of an answer."""
