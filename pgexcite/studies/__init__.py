"""What runs many simulations, or looks at finished ones: clearing times, equal areas, comparisons."""
