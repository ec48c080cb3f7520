"""Participants side by side, on one data set or on several: figures by object as text, CSV, JSON and a page."""
