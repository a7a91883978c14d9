"""Pictures that show a measurement: strips with labels, error over time, images finer than an analysis looks at."""
