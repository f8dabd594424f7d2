"""What goes on inside motors and what feeds them: heat, a battery's voltage, magnets on teeth."""
