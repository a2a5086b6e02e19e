"""The trade-off study: what cheaper comparisons of a pair cost in accuracy, and which of them is accurate enough."""
