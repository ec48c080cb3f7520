"""What an estimate says of the photo without depth that an object was made from: pictures, and the shape corrected."""
