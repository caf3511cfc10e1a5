"""What the algorithms share: data, mathematics, networks, multipliers."""
