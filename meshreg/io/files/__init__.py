"""Files opened, decoded, named and written safely, whatever their format."""
