"""The stress study: perturb pairs of clouds step by step, and find where each method breaks and whether it says so."""
