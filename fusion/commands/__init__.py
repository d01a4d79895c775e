"""The commands of `stario`, one file each; `stario.fusion.cli` registers them."""
