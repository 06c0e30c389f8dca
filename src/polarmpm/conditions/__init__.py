"""Supports, loads and prescribed motion as functions of the load factor."""
