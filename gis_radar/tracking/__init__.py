"""Vehicles: followed along the lanes, with what they occupy and hide."""
