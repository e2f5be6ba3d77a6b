"""The way of the sound, a stage a file, each named by the noun it makes; none imports another."""
