"""What is believed about the vehicle, computed once per tick; knows no phases and no decisions."""
