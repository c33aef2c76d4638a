"""Solids from primitives and booleans, every face numbered, and line drawings of them."""

from rangecheck.modeler.draw import Drawing, Line, draw
from rangecheck.modeler.model import Lamp, Model
from rangecheck.modeler.scene_file import model_from_dict, read_model
from rangecheck.modeler.svg import svg_text, write_svg

__all__ = ["Drawing", "Lamp", "Line", "Model", "draw", "model_from_dict", "read_model", "svg_text", "write_svg"]
