"""Costs that come with persist: how far what an agent would see is from its goal."""
