"""What others see of the live system: the page, layers, OGC features, SensorThings."""
