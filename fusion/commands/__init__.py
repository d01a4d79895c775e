"""The commands of `stario`, one file each; `stario.fusion.commands.cli` registers them."""
