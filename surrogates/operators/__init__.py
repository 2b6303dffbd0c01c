"""Graph operators, convolutions and upsampling."""
