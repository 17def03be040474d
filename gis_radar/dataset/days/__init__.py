"""What follows from the hours of a date, by tile and lane, and its sums by month."""
