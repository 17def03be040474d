"""The files of a report, by name."""

PAGE, PDF = "report.html", "report.pdf"
LANES_FILE, LANES_BY_INTERVAL = "lanes.csv", "lanes_by_interval.csv"
QUALITY = "quality.csv"
TRAFFIC_FILE, TURNS_FILE = "traffic.csv", "turns.csv"
REPORT_FILES = (PAGE, PDF, LANES_FILE, LANES_BY_INTERVAL, QUALITY, TRAFFIC_FILE, TURNS_FILE)
