"""What is known so far, what is missing, and the next pose that helps most."""
