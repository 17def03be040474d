"""Traffic as people read it: by lane and turn, at count sections, by cycle of signals."""
