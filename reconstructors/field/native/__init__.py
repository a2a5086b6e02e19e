"""Compiled rays through the radiance field, with bit-identical results for any thread count and instruction set."""
