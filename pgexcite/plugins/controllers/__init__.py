"""Controllers: sampled, and blind to everything they do not measure or are expressly handed."""
