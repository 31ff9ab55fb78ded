"""The kernel: declarations, components, the network, assembly, stepping, configuration and records."""
