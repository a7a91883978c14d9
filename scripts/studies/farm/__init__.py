"""What a shot takes on a farm: measured on one machine, planned by simulation of its graph; docs/farm.md."""
