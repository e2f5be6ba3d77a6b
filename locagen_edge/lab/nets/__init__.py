"""The networks of the paper: torch modules from features to the azimuth's cosine and sine."""
