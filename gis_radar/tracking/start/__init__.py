"""The vehicles that the posterior begins with: followed by a filter, and completed at rest."""
