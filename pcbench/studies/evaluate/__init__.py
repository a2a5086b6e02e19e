"""`pcbench evaluate`: many scenes and methods by one protocol, in one table."""
