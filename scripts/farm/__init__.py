"""The commands of a shot on a farm: `lipac farm` writes the job, `lipac shot` does its steps."""
