"""The site wizard: from a map and clicks on it to a site file, its check and its run."""
