"""Cutting physics: finite elements, cut surface, knife and board; no Drake."""
