"""The whole refrigerator: cold box, nitrogen pre-cooler and compression station, with the station's controller."""
