"""Radiance along rays: wavefront stages, the plan, the film."""
