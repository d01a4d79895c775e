"""The commands of `stario`; `stario.fusion.commands.cli` registers them."""
