"""What sensors and the centre share: settings, messages, the broker, and what waits to be sent."""
