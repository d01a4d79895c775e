"""The networks that the paper compares StarIO with."""
