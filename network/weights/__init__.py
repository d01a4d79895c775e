"""Packaged weights with their cards, and the recipes that they were trained with."""
