"""The picture of the panel: images, frames, stages and what is drawn over them."""
