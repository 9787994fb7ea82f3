"""The process that runs a bundle's functions, told what to do over a channel."""
