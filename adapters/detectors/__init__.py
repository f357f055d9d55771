"""Other people's drift detectors, under the loop's detector port; `mape.registry` has their short names."""
