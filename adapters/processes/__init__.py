"""The loop as processes: each role in one of its own, and who starts and watches them."""
