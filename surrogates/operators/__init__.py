"""Graph operators, convolutions, upsampling, and the compiled path."""
