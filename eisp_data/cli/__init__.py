"""The commands: each module is one, or the part of one that its name says."""
