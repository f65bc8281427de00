"""Training of networks, their evaluation, and the reproduction of the tables of Almanza-Medina."""
