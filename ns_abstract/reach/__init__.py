"""A network in the loop: states over time where control comes from rendered pictures (docs/dev/design.md, L)."""
