"""The edges of the framework: environments, buses, other people's detectors, results, figures, and the CLI."""
