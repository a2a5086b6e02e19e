"""The experiment on deformation: one scene with a known truth, solved with different settings."""
