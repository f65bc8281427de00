"""Training recipes, one a network of Almanza-Medina's tables 3.1 to 3.7, 3.10 and 3.11; what one leaves out is
Almanza-Medina's."""
