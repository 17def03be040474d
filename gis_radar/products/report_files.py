"""The files of a report, by name."""

PAGE, PDF = "report.html", "report.pdf"
LANES, LANES_BY_INTERVAL = "lanes.csv", "lanes_by_interval.csv"
QUALITY = "quality.csv"
TRAFFIC, TURNS = "traffic.csv", "turns.csv"
REPORT_FILES = (PAGE, PDF, LANES, LANES_BY_INTERVAL, QUALITY, TRAFFIC, TURNS)
