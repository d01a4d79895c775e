"""The networks that the paper compares StarIO with, one file each."""
