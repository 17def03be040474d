"""From messages to recordings, and to the measures of quarters and hours."""
