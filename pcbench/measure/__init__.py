"""What is measured between a reference and its candidates."""
