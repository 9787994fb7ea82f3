"""What is shown of one value?"""
