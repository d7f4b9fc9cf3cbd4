"""Recipes of floaters, by people who had not read what finds them."""
