"""The simulator inside an algorithm: reflectance, lights and poses recovered from photographs, and scans judged by them."""
