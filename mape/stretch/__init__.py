"""Stretches of quiet passes, each as one compiled call."""
