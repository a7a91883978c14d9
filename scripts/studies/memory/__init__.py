"""What renders take: rates from scenes of one kind of thing each, and renders within `--memory`."""
