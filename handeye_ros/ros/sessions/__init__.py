"""Sessions on the disk: a bag with one complete file for each thing that happened."""
