"""What an answer says: its quality, the evidence for it, table and HTML report."""
