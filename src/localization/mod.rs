//! Where the car is: Monte Carlo localization in the mesh map.
