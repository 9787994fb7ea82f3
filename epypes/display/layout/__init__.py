"""Where does everything go?"""
