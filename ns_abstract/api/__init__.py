"""The Python interface, which the command lines call; its public names are those of `ns_abstract`."""
