"""The quality of one cloud, or of two side by side: what `pcbench quality` computes and writes."""
