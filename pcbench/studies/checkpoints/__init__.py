"""The accuracy of a cloud by check points: what `pcbench checkpoints` computes and writes."""
