"""What bench/fuzz.py damages, and how: messages, files and sessions."""
